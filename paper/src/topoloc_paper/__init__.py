"""The experiments of the paper that topoloc realises. Adds `topoloc benchmark` to topoloc's
commands."""

COMMANDS = {
    "benchmark": (
        "topoloc_paper.benchmark",
        "the paper's tables and figures, ours and others' beside them",
    )
}
