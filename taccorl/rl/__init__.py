"""PPO in the twin with a real-data anchor: the paper's post-training (§3.4).

numbers       flow_sde → advantages → critic → ppo, anchor        tensors in, tensors out
policy        flow_policy, exploration (size of the noise)
environments  twin_shard (in one process, with start_states) → shards (which process) → twin_world (the policy's inputs)
a run         settings, rollout → post_train → checkpoint, run_settings, watched_episode (Rerun)
"""
