"""`maniple log ...`: a module for each command; `group.py` lists them."""
