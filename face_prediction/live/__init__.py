"""Forecasts while a camera runs."""
