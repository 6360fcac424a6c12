"""Settings: frozen pydantic models, their presets, and how YAML and command line become one of them."""
