"""The reference solver beside NVIDIA Newton's, step for step."""
