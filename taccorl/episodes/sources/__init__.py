"""Who acts in the twin: scripted experts, people, MimicGen, a policy that an expert corrects, stored actions."""
