"""Triangle meshes: connectivity, coarser levels, what is nearest. Knows no cloth."""
