"""Discovery: which effects the training record supports."""
