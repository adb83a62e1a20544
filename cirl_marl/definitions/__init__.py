"""Networks as TOML files: reading, writing, the catalogue, and mistakes in the words of the file."""
