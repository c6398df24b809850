"""``python -m sb3_progpolicy``: the command line, where its script is not on the path."""

from sb3_progpolicy.cli import main

main()
