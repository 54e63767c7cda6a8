"""Simulation of a garment on a character, frame by frame, with any animator."""
