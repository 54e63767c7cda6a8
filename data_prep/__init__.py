"""Programs that make bodies, garments and motions in clothjax's schema; the library imports none of them."""
