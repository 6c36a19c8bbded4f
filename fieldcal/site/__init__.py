"""The fleet as a site of linked pages below ROOT/site: every vehicle, every flight, current after each night."""

from fieldcal.site.write import INDEX, write_site

__all__ = ["INDEX", "write_site"]
