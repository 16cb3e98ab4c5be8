"""Teaching a map the paper's learned coarse localizers. Adds `topoloc train` to topoloc's commands,
and its settings to their file."""

COMMANDS = {
    "train": ("topoloc_training.train", "add a learned coarse localizer to a map, or train it anew")
}
TABLES = {"train": ("topoloc_training.coarse_training", "CoarseTrainingConfig", ("train",))}
