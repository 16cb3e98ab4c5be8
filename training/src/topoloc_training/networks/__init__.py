"""Published networks of local features, written anew under their published key names, and their
export to ONNX."""
