from dataclasses import dataclass


@dataclass(frozen=True)
class ExportMotionOptions:
    """x"""

    a: int = 0


def run_export_motion(o):
    return 0
