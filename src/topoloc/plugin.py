"""Interfaces and helpers for extensions: recording formats, feature types, coarse localizers,
stores, exporters and commands.

Extensions import from here and from `topoloc`. `plugin.pyi` lists the names. Each one loads its
module at its first use, so that importing this module is free.
"""

from topoloc import attach_stub

__getattr__, __dir__ = attach_stub(__name__, __file__)
