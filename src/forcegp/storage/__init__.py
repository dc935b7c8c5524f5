"""Storage of models and systems in safetensors files with a versioned header, TOML and JSON."""
