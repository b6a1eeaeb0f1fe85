"""Pictures and interactive views of a model."""
