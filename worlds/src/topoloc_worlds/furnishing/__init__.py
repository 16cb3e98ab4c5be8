"""What rooms are furnished with: materials, furniture, things printed and shown."""
