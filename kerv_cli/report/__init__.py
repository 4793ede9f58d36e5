"""Tables, figures, pages and recordings from stored episodes."""
