"""From result lines to figures with intervals, see ``docs/benchmark_report.md``."""
