"""The numbered messages of every twin, for readers that follow at their own pace."""
