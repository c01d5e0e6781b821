"""A training run: its settings, memory, data in tiles, session and trainers."""
