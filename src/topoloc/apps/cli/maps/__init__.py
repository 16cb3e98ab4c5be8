"""Commands that show, edit, join and export maps and atlases."""
