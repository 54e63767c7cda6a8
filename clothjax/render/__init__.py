"""Moving meshes as pictures and animation files. Knows no model."""
