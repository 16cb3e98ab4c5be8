"""How the weights of a kind of features come about: `python -m topoloc_paper.fit --kind KIND`."""
