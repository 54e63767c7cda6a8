"""A page that plays garments in the browser alone."""
