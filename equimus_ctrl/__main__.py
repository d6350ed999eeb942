"""``python -m equimus_ctrl``: the command where its script is not on the path."""

from equimus_ctrl.cli.main import entry

if __name__ == "__main__":
    entry()
