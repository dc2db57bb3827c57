"""`qrl fly`: a trained policy of any vehicle with a vehicle of the user's, judged and shown."""

import argparse

from qrl.cli.evaluate import evaluate
from qrl.cli.view import view


def fly(args: argparse.Namespace) -> int:
    """As `qrl evaluate` and then `qrl view`."""
    both = {"run": args.run, "vehicle": args.vehicle, "reference": args.reference}
    evaluate(argparse.Namespace(**both, starts=args.starts, checkpoints=1, off_nominal=args.off_nominal, beside=[]))
    return view(argparse.Namespace(**both, starts=None, out=None, kernel=args.kernel))
