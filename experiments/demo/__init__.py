"""A character that is steered in the browser, and the garment on it."""
