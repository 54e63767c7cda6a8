"""Triangle meshes: connectivity, coarser levels, nearest points and faces. Knows no cloth."""
