"""The scene kept empty where the masks of an object exclude pixels."""
