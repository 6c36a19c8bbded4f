"""What keeps a warehouse whole, of this version, and small."""
