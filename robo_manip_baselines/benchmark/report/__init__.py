"""Report of a benchmark: figures, and one page with tables, figures, videos and result rows."""
