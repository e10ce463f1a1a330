"""The estimator that the node and ins_replay share: messages in, reports out."""
