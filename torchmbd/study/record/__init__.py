"""What is kept of a study: evaluations and state on disk, runs in the tracking store, and how to continue from them."""
