"""Plots as SVG: the same bytes for the same figures, in the colours of the page around them.

Matplotlib is imported where something is drawn.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure


INK = "#1f2328"
"""of axes and words; a page may put its own colour in place of it."""

BLUE, ORANGE, GREEN, RED = "#0072b2", "#e69f00", "#009e73", "#d55e00"
SKY, PINK, YELLOW, GREY = "#56b4e9", "#cc79a7", "#f0e442", "#8c8c8c"
"""Colours that colour-blind readers can tell apart (Okabe and Ito)."""


@dataclass(frozen=True)
class Plot:
    """A plot.

    Attributes:
        name: of its file, without ending.
        title: above it.
        caption: what is drawn.
        summary: what is to be seen, for readers who cannot see it.
        svg: the picture, a whole SVG document.
    """

    name: str
    title: str
    caption: str
    summary: str
    svg: str

    @property
    def inline(self) -> str:
        """The picture as an element of a page: names of its own, ink as the text around it."""
        svg = self.svg[self.svg.index("<svg") :].replace(INK, "currentColor")
        svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
        svg = re.sub(r'\bid="', f'id="{self.name}-', svg)
        svg = re.sub(r'href="#', f'href="#{self.name}-', svg)
        svg = svg.replace("url(#", f"url(#{self.name}-")
        label = f'role="img" aria-labelledby="{self.name}-title {self.name}-summary"'
        return svg.replace("<svg", f"<svg {label}", 1)


@contextmanager
def new_figure(name: str, width: float, height: float) -> Iterator[tuple[Figure, Any]]:
    """Give an empty figure in the report's look, and where its SVG will stand.

    Args:
        name: of the plot; its identifiers are made from it.
        width: inches.
        height: inches.

    Yields:
        The figure and an `io.StringIO` that holds the SVG when the block has ended.

    Raises:
        RequestError: matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
        from matplotlib.backends.backend_svg import FigureCanvasSVG
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RequestError(
            f"plots need matplotlib ({error}); pip install 'robo_manip_baselines[train]'"
        ) from None
    colours = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")
    look: Any = {
        **dict.fromkeys(colours, INK),
        "axes.facecolor": "none",
        "axes.spines.right": False,
        "axes.spines.top": False,
        "font.size": 10.0,
        "grid.alpha": 0.3,
        "grid.color": GREY,
        "legend.facecolor": "none",
        "legend.framealpha": 0.0,
        "svg.fonttype": "none",
        "svg.hashsalt": name,
    }
    stream = io.StringIO()
    with mpl.rc_context(look):
        figure = Figure(figsize=(width, height), layout="constrained", facecolor="none")
        FigureCanvasSVG(figure)
        yield figure, stream
        figure.savefig(stream, format="svg", dpi=150, metadata={"Date": None, "Creator": None})


def write_plots(folder: Path, plots: Sequence[Plot]) -> list[Path]:
    """Write every plot as an SVG on white; return the paths."""
    paths = []
    for plot in plots:
        path = folder / f"{plot.name}.svg"
        with atomic_file(path) as temporary:
            # Ink is dark: a page in the dark would swallow it.
            start = plot.svg.index(">", plot.svg.index("<svg")) + 1
            ground = '<rect width="100%" height="100%" fill="#ffffff"/>'
            temporary.write_text(plot.svg[:start] + ground + plot.svg[start:], encoding="utf-8")
        paths.append(path)
    return paths
