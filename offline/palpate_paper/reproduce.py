"""`palpate reproduce`: the figures of BaniHani & De 2009 and three more, each a plot and a table, and one page of them all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from palpate.files import make_folder
from palpate.plots import require_matplotlib
from palpate.progress import NO_PROGRESS, Progress
from palpate_paper import convergence, discretizations, errors_and_times, frequency_responses, orders
from palpate_paper.center_displacement import center_displacement
from palpate_paper.figure import Figure
from palpate_paper.page import write_page
from palpate_paper.reaction_force import reaction_force
from palpate_paper.study import Study

FIGURES: dict[int, Callable[[Study], Figure]] = {
    2: center_displacement,
    3: convergence.disc,
    4: lambda study: frequency_responses.frequency_response(study, study.disc, 4),
    5: lambda study: errors_and_times.error_and_time(study, study.disc, 5),
    6: convergence.square,
    7: lambda study: frequency_responses.frequency_response(study, study.square, 7),
    8: lambda study: errors_and_times.error_and_time(study, study.square, 8),
    9: convergence.cube,
    10: lambda study: frequency_responses.frequency_response(study, study.cube, 10),
    11: reaction_force,
    12: lambda study: errors_and_times.error_and_time(study, study.cube, 12),
    13: errors_and_times.products,
    14: orders.error_against_order,
    15: discretizations.both_discretizations,
    16: orders.passivity,
}
"""Those of the paper by its numbers (figure 1 is a sketch), then ours."""


def reproduce(
    numbers: Sequence[int], out: Path, quick: bool = False, progress: Progress = NO_PROGRESS
) -> list[Path]:
    """Plot and table of each figure in OUT/images/paper and, when all are drawn, the page OUT/paper.md.

    numbers  of the figures; empty for all

    Returns the plots and the page. Raises ValueError for a number that is no figure's.
    """
    unknown = sorted(set(numbers) - set(FIGURES))
    if unknown:
        raise ValueError(
            f"figure {unknown[0]}: expected numbers from {min(FIGURES)} to {max(FIGURES)} (figure 1 is a sketch)"
        )
    require_matplotlib()
    images = out / "images" / "paper"
    make_folder(images)
    study = Study(quick, progress.note)
    figures, written = [], []
    for number in sorted(set(numbers) or FIGURES):
        progress(f"figure {number}")
        figure = FIGURES[number](study)
        figure.write(images)
        progress.note(figure.title)
        figures.append(figure)
        written.append(images / f"{figure.stem}.png")
    if len(figures) == len(FIGURES):
        page = out / "paper.md"
        write_page(figures, page, quick)
        written.append(page)
    return written
