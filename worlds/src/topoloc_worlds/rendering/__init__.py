"""A scene and a camera pose become light and depth: Mitsuba 3, light traced once for a world, and
the filter that does without that."""
