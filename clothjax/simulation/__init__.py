"""A garment on a character, frame by frame, whatever moves it."""
