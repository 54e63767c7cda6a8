"""The character in a garment: rotations, skinning, motion clips, a player to steer it."""
