"""``report.html``: a benchmark on one page, see ``docs/benchmark_report.md``."""
