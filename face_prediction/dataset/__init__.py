"""Face tracks and their videos to sequences that predictors learn from, and back."""
