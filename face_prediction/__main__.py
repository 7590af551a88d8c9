"""``python -m face_prediction``."""

from __future__ import annotations

import sys

from face_prediction.commands.cli import main

if __name__ == "__main__":
    sys.exit(main())
