"""Residual prediction: linear experts that keep learning from the face that they follow."""
