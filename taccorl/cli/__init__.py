"""``taccorl <verb>``: one file per verb, loaded only when asked for."""
