"""Models and systems in files: safetensors with a versioned header, TOML and JSON."""
