"""Checkpoints of minimize as version 0.2 wrote them: the content of files after two iterations from (-1.2, 1)."""

import numpy as np

from sparsedp.io.atomic_files import save_tree

__all__ = ["CHECKPOINTS", "write_checkpoint_0_2"]

FORMAT = "sparsedp optimization 4"
START = "54033e32ae2cd1a78d8a2c0b216b75a2a01fba300d82ab30070c74cd8c2ab878"
NO_OPTIONS = "4f53cda18c2baa0c0354bb5f9a3ecbe5ed12ab4d8e11ba873c2f11161202b945"
NO_BOUNDS = "6011d7b34763d30da21feed9c9c3c93e6a47b721778b78ec75d5950ca6a5ff36"
NO_BATCHES = "0a1bc5b8b2fc760b94d3ed176563d8abeaebf699d36bfe49e68306a923f2d207"
# Of each method: the state (point, loss, gradient, rounding and iteration come first), the loss, the norm of the
# gradient and the count of evaluations in each iteration, and the hashes of what the run depends on.
CHECKPOINTS = {
    "lbfgs": {
        "state": [
            np.array([-0.9831951667076021, 0.9]),
            4.377588439653959,
            np.array([-30.187314983934172, -13.334547167437893]),
            9.720198956073475e-16,
            2,
            np.array([[0.11044380605740356, 0.0], [0.1063610272349943, 0.0]]),
            np.array([[0.2622695371287194, 0.09877628915676692], [0.19361461329328397, 0.08611717340683092]]),
            512.0,
        ],
        "history": [
            (33.99999999999999, 263.5999999999999, 1),
            (12.610763814714502, 129.31799699009557, 2),
            (4.377588439653959, 30.187314983934172, 3),
        ],
        "settings": {
            "method": "3a7cc4a8a7697b9755dabbcbeb369a28c84f089d8f691dc77344a9c636c952f9",
            "set of options": NO_OPTIONS,
            "pair of bounds": "66f89de3b31deeb710480e6f407f8a5b56e3a209963ed3d6133b74b5b3f9e209",
            "start": START,
            "loss at the start": "bea35dfbeee557d6729776aecd7a3fdabaf3e39d94bacce2ceb38414cf9c25e5",
            "list of batches": NO_BATCHES,
        },
    },
    "gd": {
        "state": [
            np.array([-1.0294638933441773, 1.0712367423633264]),
            4.131812964168546,
            np.array([0.6522426918246209, 2.288166932794944]),
            9.174467772529273e-16,
            2,
            np.array([0.07432046938341978, 0.031965053680713014]),
            0.0017850767583006072,
            1.0,
        ],
        "history": [
            (24.199999999999996, 232.8676877542266, 1),
            (7.632451770153153, 90.64373101305645, 2),
            (4.131812964168546, 2.379312598498745, 3),
        ],
        "settings": {
            "method": "69840d8fbdc72843a617f1bab9d3fb5c25050611d282ac2e7c877a51f40ec7af",
            "set of options": NO_OPTIONS,
            "pair of bounds": NO_BOUNDS,
            "start": START,
            "loss at the start": "04636e384c2eb4c2cf01ff97e3c40cd9448a6047df153538590cc808428c0d19",
            "list of batches": NO_BATCHES,
        },
    },
    "adam": {
        "state": [
            np.array([-1.1021110248351322, 1.098076218199085]),
            5.777785369987549,
            np.array([-55.59455388086854, -23.31449857281207]),
            1.2829260698205111e-15,
            2,
            np.array([-0.1264414067824674, -0.052226562720315346]),
            np.array([0.0009650573653176297, 0.00016336831758845223]),
            2,
            256.0,
            1.0,
        ],
        "history": [
            (24.199999999999996, 232.8676877542266, 1),
            (12.04812515624487, 140.63915854033309, 2),
            (5.777785369987549, 60.28532379372653, 3),
        ],
        "settings": {
            "method": "11e5ffda3da742acf6ef6c5f8f03084f361b83a79f73f0a044a3c640d47e3afb",
            "set of options": "0fe65512d19d87d7720b73c011e52302efa5ead117c7aaa2a416ed6b94283b56",
            "pair of bounds": NO_BOUNDS,
            "start": START,
            "loss at the start": "04636e384c2eb4c2cf01ff97e3c40cd9448a6047df153538590cc808428c0d19",
            "list of batches": NO_BATCHES,
        },
    },
    "newton_cg": {
        "state": [
            np.array([-1.0308940228699568, 1.0689491107013913]),
            4.1283827506644295,
            np.array([-1.502439283403696, 1.2413248624776774]),
            9.166851168505973e-16,
            2,
            0.0,
            232.8676877542266,
        ],
        "history": [
            (24.199999999999996, 232.8676877542266, 1),
            (4.567782114503026, 30.944981778889954, 2),
            (4.1283827506644295, 1.9489000011595863, 3),
        ],
        "settings": {
            "method": "93f1550d70ac9fcd83b1bcddb8d1212f1fb407c9e6d2ac6eab76e33fde509a84",
            "set of options": NO_OPTIONS,
            "pair of bounds": NO_BOUNDS,
            "start": START,
            "loss at the start": "04636e384c2eb4c2cf01ff97e3c40cd9448a6047df153538590cc808428c0d19",
            "list of batches": NO_BATCHES,
        },
    },
    "levenberg_marquardt": {
        "state": [
            np.array([-0.09474539100478874, -0.26855525467544045]),
            4.450432726813924,
            np.array([-6.353719897184925, -27.75319437920907]),
            9.881945765708275e-16,
            2,
            1.1801755486285912,
            1.0,
        ],
        "history": [
            (12.099999999999998, 116.4338438771133, 1),
            (6.601743300631963, 53.31410577403966, 2),
            (4.450432726813924, 28.471205713528285, 4),
        ],
        "settings": {
            "method": "4046befeb7a866df1c8a380b66f49126561d01dc95d2e3b7cb2d3aacc5d131ac",
            "set of options": NO_OPTIONS,
            "pair of bounds": NO_BOUNDS,
            "start": START,
            "loss at the start": "0c36527ab250494ea93c493282bef88b1d5dd0e80d0dec379f2b1f9d9f6de436",
            "list of batches": NO_BATCHES,
        },
    },
    "levenberg_marquardt, large": {
        "state": [
            np.array([-0.09474539100477863, -0.26855525467544805]),
            4.450432726814072e140,
            np.array([-6.353719897184465e140, -2.7753194379209647e141]),
            9.881945765708604e124,
            2,
            1.1801755486285962e140,
            1.0,
        ],
        "history": [
            (1.21e141, 1.1643384387711334e142, 1),
            (6.601743300632117e140, 5.3314105774040226e141, 2),
            (4.450432726814072e140, 2.847120571352874e141, 4),
        ],
        "settings": {
            "method": "4046befeb7a866df1c8a380b66f49126561d01dc95d2e3b7cb2d3aacc5d131ac",
            "set of options": NO_OPTIONS,
            "pair of bounds": NO_BOUNDS,
            "start": START,
            "loss at the start": "d87ee654d6cc7fa652723e8a85f1deeb014f3afd1a4fdead1d9d8953d86d5a48",
            "list of batches": NO_BATCHES,
        },
    },
    "half_inverse": {
        "state": [
            np.array([-0.8160270986748105, 0.5028526799086951]),
            2.978577425436991,
            np.array([-28.395629174043414, -16.28475458629338]),
            6.613770476697736e-16,
            2,
            0.0,
            1.0,
        ],
        "history": [
            (12.099999999999998, 116.4338438771133, 1),
            (5.2459334664538515, 58.530142703302054, 2),
            (2.978577425436991, 32.733850798914396, 3),
        ],
        "settings": {
            "method": "1ec0ec30ac2817985b07d693ee00af593b4ff01289f43ccd0684fd83459fa6bb",
            "set of options": "c0687e2d9adf1970ca70210eb0dd043f1c15c7cc4381704d7e8626b11066030f",
            "pair of bounds": NO_BOUNDS,
            "start": START,
            "loss at the start": "0c36527ab250494ea93c493282bef88b1d5dd0e80d0dec379f2b1f9d9f6de436",
            "list of batches": "16738410732fbc610d57272997f7f555d287c1e5e21aa2d674a77472e4bd2349",
        },
    },
}


def write_checkpoint_0_2(folder, name):
    """Write the checkpoint of a method as version 0.2 did."""
    run = CHECKPOINTS[name]
    history = [(row, value, slope, 0.0, count, (), 0) for row, (value, slope, count) in enumerate(run["history"])]
    content = {
        "iteration": 2,
        "settings": run["settings"],
        "ranks": 1,
        "evaluations": history[-1][4],
        "state": run["state"],
        "best": run["state"][:5],
        "history": history,
    }
    save_tree(folder / "state-000000002.npz", content, FORMAT)
