"""What is told of models and motions beside their numbers: warnings, causes of failures, errors of responses."""
