"""A finished model in the formats of other runtimes, and run in them."""
