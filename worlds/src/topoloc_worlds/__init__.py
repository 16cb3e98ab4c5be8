"""Worlds with exact truth, rendered: a lab, a corridor, a street. Adds `topoloc simulate` to
topoloc's commands."""

COMMANDS = {
    "simulate": (
        "topoloc_worlds.simulate",
        "render a built-in world (lab, corridor, hospital, street) with exact truth",
    )
}
