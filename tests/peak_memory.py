"""Measure the peak memory of a program that a test starts. `ru_maxrss` would include the test
process, whose memory other tests have filled."""

from __future__ import annotations

PEAK_KB = (
    "def peak_kb():\n    with open('/proc/self/status') as file:\n"
    "        return next(int(one.split()[1]) for one in file if one.startswith('VmHWM'))\n"
)
"""Source of a function that returns the peak of the calling process, kB."""
