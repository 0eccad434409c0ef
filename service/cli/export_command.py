"""`lvba export`: a result in other formats."""

import argparse
import sys

from lvba.products.export import export as write
from service.cli.progress import Display


def export(arguments: argparse.Namespace, display: Display) -> None:
    """Write the result as FORMAT and say where it is."""
    display.stage(f"export {arguments.format}", 0, 1)
    written = write(arguments.result, arguments.format, arguments.out, display.progress, crs=arguments.crs)
    display.clear()
    sys.stdout.write(f"{written}\n")
