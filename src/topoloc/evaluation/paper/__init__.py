"""The paper's tables and figures, made again: `topoloc benchmark`."""
