"""Pictures of networks, by matplotlib without its global state; import it where a picture is wanted."""
