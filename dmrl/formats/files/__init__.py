"""Plain files: image folders, label tables and CSV flights."""
