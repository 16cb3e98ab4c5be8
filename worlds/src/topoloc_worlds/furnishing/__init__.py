"""Build the furnishing of rooms: materials, furniture, prints and screens."""
