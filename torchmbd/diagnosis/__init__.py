"""What a motion says beside its numbers: warnings, causes of failures, errors of responses."""
