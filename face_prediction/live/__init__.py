"""Forecasting while the camera runs."""
