"""Bugs of `parallel/` that several processes see: what stands there, what instead, and the tests that fail then."""

BUGS_ON_RANKS = {
    "on ranks, a gradient of which one block comes back": (
        "back = DistributedField.gather if shape else _sum",
        "back = (lambda g: g.like(g.flat * (g.layout.comm.rank == 0)).gather()) if shape else _sum",
        "tests/parallel/test_ranks.py::test_as_on_one_process[fields-2]",
    ),
    "on ranks, a cotangent of a number that is not summed": (
        "back = DistributedField.gather if shape else _sum",
        "back = DistributedField.gather if shape else (lambda g: g.flat.sum())",
        "tests/parallel/test_ranks.py::test_as_on_one_process[fields-2]",
    ),
    "on ranks, a sum of the block": (
        "return x.layout.sum(x.flat.sum())",
        "return x.flat.sum()",
        "tests/parallel/test_ranks.py::test_as_on_one_process[fields-2]",
    ),
    "on ranks, a halo that is too thin": (
        "(read.min(), -read.max() - 1)",
        "(read.min(), -read.max())",
        "tests/parallel/test_ranks.py::test_as_on_one_process[fields-2]",
    ),
    "on ranks, a halo that was brought before": (
        '            self.agreement.synchronize("exchange")',
        "            values = vars(self).setdefault('sent', values.copy()).astype(values.dtype)\n"
        '            self.agreement.synchronize("exchange")',
        "tests/parallel/test_ranks.py::test_as_on_one_process[fields-2]",
    ),
    "on ranks, what a halo gives back that is not added": (
        '"reduce", MPI.SUM',
        '"reduce", MPI.REPLACE',
        "tests/parallel/test_ranks.py::test_as_on_one_process[transport-2]",
    ),
    "on ranks, A for the transpose of A": (
        "self.structure_of(self.op.T if transposed else self.op).product(x)",
        "self.structure_of(self.op).product(x)",
        "tests/parallel/test_ranks.py::test_as_on_one_process[solves-2]",
    ),
    "on ranks, J for the transpose of J": (
        "return structure.inner[structure.transposed]",
        "return structure.inner[0]",
        "tests/parallel/test_ranks.py::test_as_on_one_process[newton-2]",
    ),
    "on ranks, a refusal at a trial point of one rank alone": (
        '"a trial", act, *args, at_once=True',
        '"a trial", act, *args',
        "tests/parallel/test_ranks.py::test_as_on_one_process[newton-2]",
    ),
    "on ranks, a number that is not compared": (
        "        self.layout.compare(value)\n        return value",
        "        return value",
        "tests/parallel/test_errors_ranks.py::test_an_error_of_one_rank_is_that_of_all",
    ),
}
