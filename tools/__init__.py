"""Commands for those who work on layerjax: pages of docs made from the source, and checks that need environments."""
