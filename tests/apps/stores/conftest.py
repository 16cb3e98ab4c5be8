"""Import the fixtures of a second map and of buckets."""

from atlas_fixtures import *  # noqa: F403
