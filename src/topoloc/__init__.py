"""topoloc."""
