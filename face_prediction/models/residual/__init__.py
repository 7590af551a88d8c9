"""Residual prediction: a prior that adapts to the face it watches, corrected by a network."""
