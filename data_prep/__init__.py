"""Programs that make bodies, garments and motions as files of clothjax; the library imports none of them."""
