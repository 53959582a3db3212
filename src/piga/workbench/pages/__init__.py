"""The pages of the workbench. Each module holds the routes of its pages; ``workbench/templates`` has their templates."""
