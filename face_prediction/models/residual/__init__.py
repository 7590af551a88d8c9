"""Residual prediction: an adaptive prior, corrected by a network."""
