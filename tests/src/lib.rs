//! Placeholder of `gadm-integration-tests`; replaced by its first commit.
