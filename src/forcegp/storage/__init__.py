"""Models and systems as folders of versioned JSON and safetensors."""
