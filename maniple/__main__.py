"""`python -m maniple`: the command line."""

from maniple.cli.main import main

main()
