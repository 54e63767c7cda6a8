"""A character steered in the browser, and the garment on it."""
