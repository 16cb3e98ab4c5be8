"""`topoloc-net`: our own network of local features, and how it is trained."""
