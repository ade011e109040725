"""Result records, the checkpoints they belong to, the tables made from them, and the check of both."""
