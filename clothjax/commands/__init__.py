"""The programs of an installed clothjax: arguments in, the library called, lines out."""
