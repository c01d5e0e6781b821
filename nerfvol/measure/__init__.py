"""Scores, truth, speed and plots."""
