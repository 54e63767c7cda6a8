"""`python -m clothjax doctor`: what is installed, what runs on what, and what is missing for which command."""

import argparse
import sys

from clothjax import doctor


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m clothjax", description=__doc__)
    parser.add_argument("command", choices=["doctor"])
    parser.parse_args(argv)
    lines, sound = doctor.report()
    print("\n".join(lines))
    raise SystemExit(0 if sound else 1)


if __name__ == "__main__":
    main(sys.argv[1:])
