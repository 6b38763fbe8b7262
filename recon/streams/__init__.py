"""Pictures over time: video, live view, activity."""
