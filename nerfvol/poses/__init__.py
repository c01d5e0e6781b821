"""Photographs or a video to cameras: which pictures, which cameras took them, structure from motion, what went wrong."""
