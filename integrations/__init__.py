"""The Python APIs of other Gaussian rasterizers, one module each, on this package's core; see README.md here.

A module decides what is returned. None of them guesses it from its arguments. A rasterizer of contracts.py that has no
file here is a module all the same: flavours.py makes it when it is imported.
"""
import sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec

from .contracts import CONTRACTS


class _OfTheTable(MetaPathFinder, Loader):
    """Finds the modules that have an entry in CONTRACTS and no file."""

    def find_spec(self, fullname, path=None, target=None):
        package, _, name = fullname.rpartition(".")
        known = package == __name__ and name in {contract.name for contract in CONTRACTS}
        return ModuleSpec(fullname, self) if known else None

    def create_module(self, spec):
        return None  # an ordinary one

    def exec_module(self, module):
        from .flavours import fill

        fill(module)


sys.meta_path.append(_OfTheTable())  # behind the finder of files
