"""Model: predicts the thread behind the needle."""
