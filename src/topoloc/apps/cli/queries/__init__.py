"""Commands that localize images, and that judge or explain the answers."""
