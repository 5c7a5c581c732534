"""Draws the pictures of docs/notebook.md and docs/tour.md anew, by the code on the pages.

    python scripts/notebook_figures.py

Run it where configs/ is, and the my-organ.toml, my-organ.npz and touchable.npz of docs/tour.md.
"""

from __future__ import annotations

import ast
import re
import shutil
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

DOCS = Path(__file__).parents[1] / "docs"
PICTURES = {
    "plot_press": "notebook_press",
    "plot_response": "notebook_response",
    "plot_cloud": "notebook_cloud",
    "plot_modes": "notebook_modes",
    "plot_error_against_order": "notebook_orders",
}
"""The picture of each function's call on the page."""

TOUR_PICTURES = ("press.png", "touch.png")


def main() -> None:
    blocks = re.findall(
        r"^```python\n(.*?)^```$", (DOCS / "notebook.md").read_text(), re.MULTILINE | re.DOTALL
    )
    for name, figure in figures("\n".join(blocks[:-1])).items():  # the last needs a model that takes minutes
        figure.savefig(DOCS / "images" / f"{PICTURES[name]}.png", dpi=110)
    tour = (DOCS / "tour.md").read_text()
    for program in re.findall(r"<<'PROGRAM'\n(.*?)^PROGRAM$", tour, re.MULTILINE | re.DOTALL):
        exec(compile(program, "tour.md", "exec"), {})
    for name in TOUR_PICTURES:  # which the programs leave in the current folder
        shutil.move(name, DOCS / "images" / f"tour_{name}")


def figures(code: str) -> dict[str, Figure]:
    """Run the code as a notebook does: the figures that its expressions give, by the function that is called."""
    found: dict[str, Figure] = {}
    variables: dict[str, Any] = {}
    for statement in ast.parse(code).body:
        if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Call):
            value = eval(compile(ast.Expression(statement.value), "page", "eval"), variables)
            if isinstance(value, Figure):
                assert isinstance(statement.value.func, ast.Attribute)
                found[statement.value.func.attr] = value
        else:
            exec(compile(ast.Module([statement], []), "page", "exec"), variables)
    return found


if __name__ == "__main__":
    main()
