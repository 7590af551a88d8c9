"""Scores of predictors on people that they never saw, and their error statistics."""
