"""A participating medium: extinction and albedo on a grid, lit by known suns, so that it can be lit anew."""
