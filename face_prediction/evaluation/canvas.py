"""Matplotlib without a window: figures as PNG files, the same bytes for the same data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from face_prediction.errors import RequestError
from face_prediction.whole_file import whole_file

#: Colours that colour-blind readers can tell apart (Okabe and Ito), for networks.
COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: Baselines are grey, and told apart by their marks.
GREY = "#888888"
MARKS = ("o", "s", "^", "D", "v", "x", "+", "*")


def new_figure(width: float, height: float, is_laid_out: bool = True) -> Any:
    """An empty figure of this size in inches; its axes make room for their labels, or not.

    Raises:
        RequestError: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RequestError(
            f"figures need matplotlib ({error}); pip install "
            "'robo_manip_baselines[face_prediction]', or give --no_figures"
        ) from None
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained" if is_laid_out else None)
    FigureCanvasAgg(figure)
    return figure


def save_png(figure: Any, path: Path) -> None:
    """Write ``figure`` to ``path``, whole or not at all.

    Raises:
        RequestError: the folder cannot be written to.
    """
    with whole_file(path) as temporary:
        # without the name of the program: it would change with matplotlib's version
        figure.savefig(temporary, format="png", metadata={"Software": None})
