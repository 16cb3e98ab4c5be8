"""Import the fixtures of tiny recordings."""

from recording_fixtures import *  # noqa: F403
