"""Pages of HTML as a reader of them sees them."""

from html.parser import HTMLParser


class Tags(HTMLParser):
    """All tags of a page, or of a part of one, with their attributes, and its visible text."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.text = [], ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text += data
