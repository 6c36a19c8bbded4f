"""Logs made of messages on topics, whatever file they lie in: which topic is what, and its signals."""
