"""What goes into a report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from robo_manip_baselines.evaluation.benchmark_plots import benchmark_plots
from robo_manip_baselines.evaluation.figures import Plot
from robo_manip_baselines.evaluation.report.clips import EpisodeVideo
from robo_manip_baselines.evaluation.statistics.study import Study
from robo_manip_baselines.evaluation.study_tables import study_tables
from robo_manip_baselines.evaluation.tables import Table


@dataclass(frozen=True, eq=False)
class ReportData:
    """All that a report shows.

    Attributes:
        title: of the page.
        study: the figures.
        tables: made from it.
        plots: likewise.
        videos: of episodes of its arms.
        facts: what else to say at the top, such as the command and the machine: name -> text.
    """

    title: str
    study: Study
    tables: tuple[Table, ...]
    plots: tuple[Plot, ...]
    videos: tuple[EpisodeVideo, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)


def report_data(
    study: Study,
    *,
    title: str,
    videos: Iterable[EpisodeVideo] = (),
    facts: Mapping[str, str] | None = None,
) -> ReportData:
    """Make tables and plots of a study.

    Raises:
        RequestError: matplotlib is not installed.
    """
    return ReportData(
        title, study, study_tables(study), benchmark_plots(study), tuple(videos), facts or {}
    )
