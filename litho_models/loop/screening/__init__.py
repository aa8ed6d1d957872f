"""Which effects the residual asks for: score tests at the null."""
