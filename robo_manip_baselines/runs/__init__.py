"""Infrastructure of long runs: errors, atomic files, locks, interrupts, seeds, metrics, versions.

Nothing here knows faces or robots; ``face_prediction`` imports this package and nothing else of
``robo_manip_baselines`` (``docs/decisions/0001``).
"""
