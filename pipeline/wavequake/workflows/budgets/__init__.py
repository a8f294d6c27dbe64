"""What each disturbance contributes to the error of the whole."""
