"""Execute a notebook in place, without Jupyter: ``python run_notebook.py FILE.ipynb``.

The code cells are executed in order in one namespace. Printed text, the value of a last expression and the figures of
matplotlib become their outputs, as Jupyter shows them. An exception ends the run with its traceback, and the file is
not written. This needs no kernel, so that the pages and the tests depend on no package more.
"""

import ast
import base64
import io
import json
import linecache
import sys
import traceback
from contextlib import redirect_stdout
from pathlib import Path
from types import CodeType

DPI = 72  # of the figures in a notebook


def run(path):
    """Execute the code cells of a notebook and write their outputs into the file."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    namespace = {"__name__": "__main__"}
    code_cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for count, cell in enumerate(code_cells, 1):
        cell["execution_count"] = count
        cell["outputs"] = outputs("".join(cell["source"]), count, namespace)
    path.write_text(json.dumps(notebook, indent=1) + "\n", encoding="utf-8")


def outputs(source, count, namespace):
    """Execute one cell and return its outputs in the format of a notebook."""
    statements, expression = compiled(source, count)
    printed = io.StringIO()
    value = None
    with redirect_stdout(printed):
        exec(statements, namespace)
        if expression is not None:
            value = eval(expression, namespace)
    found = []
    if printed.getvalue():
        found.append({"output_type": "stream", "name": "stdout", "text": printed.getvalue().splitlines(True)})
    if value is not None:
        data = {"text/plain": repr(value).splitlines(True)}
        found.append({"output_type": "execute_result", "execution_count": count, "metadata": {}, "data": data})
    return found + figures()


def compiled(source, count) -> tuple[CodeType, CodeType | None]:
    """Compile a cell: its statements, and its last line if that is an expression whose value is shown."""
    name = f"<cell {count}>"
    linecache.cache[name] = len(source), None, source.splitlines(True), name  # tracebacks show the lines of the cell
    tree = ast.parse(source, name)
    last = tree.body[-1] if tree.body else None
    if not isinstance(last, ast.Expr):
        return compile(tree, name, "exec"), None
    tree.body.pop()
    return compile(tree, name, "exec"), compile(ast.Expression(last.value), name, "eval")


def figures():
    """Return the open figures of matplotlib as outputs, and close them."""
    pyplot = sys.modules.get("matplotlib.pyplot")
    if pyplot is None:
        return []
    found = []
    for number in pyplot.get_fignums():
        file = io.BytesIO()
        pyplot.figure(number).savefig(file, format="png", dpi=DPI)
        picture = base64.b64encode(file.getvalue()).decode("ascii")
        data = {"image/png": picture, "text/plain": ["<Figure>"]}
        found.append({"output_type": "display_data", "metadata": {}, "data": data})
    pyplot.close("all")
    return found


if __name__ == "__main__":
    try:
        run(Path(sys.argv[1]))
    except Exception:
        traceback.print_exc()  # unlike Python's own, it shows the lines of cells
        sys.exit(1)
