"""The paper's own estimators."""
