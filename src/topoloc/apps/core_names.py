"""Names of core modules for the applications of this package alone: no extension may rely on them.

`core_names.pyi` lists the names. Each one loads its module at its first use.
"""

from topoloc import attach_stub

__getattr__, __dir__ = attach_stub(__name__, __file__)
