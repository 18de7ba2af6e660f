"""axe-core, which looks for what a page keeps from people that do not see, hear or point as others do."""

from tests.e2e.lab import ROOT

SIZES = [(1920, 1080), (1440, 900), (1024, 768), (390, 844)]
_AXE = ROOT / "node_modules" / "axe-core" / "axe.min.js"
# What Django itself has in its administration: its choosers, and headings of columns without words.
_RUN = """async (colours) => {
  await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
  const COLOURS = ["color-contrast", "link-in-text-block"];
  const django = location.pathname.startsWith("/admin/");
  const { violations } = await axe.run(
    django ? { exclude: [[".select2-container"], [".help-tooltip"]] } : document, // of a part no headings are asked
    {
      resultTypes: ["violations"],
      ...(colours ? { runOnly: COLOURS } : { rules: { "empty-table-header": { enabled: !django } } }),
    },
  );
  const said = ({ any, all, none }) => [...any, ...all, ...none].map(({ message }) => message).join("; ");
  return violations.flatMap(({ id, nodes }) => nodes.map((node) => `${id}: ${node.target.join(" ")}: ${said(node)}`));
}"""
_OPEN = """() => {
  for (const closed of document.querySelectorAll("details:not([open])")) closed.open = true;
  for (const closed of document.querySelectorAll("dialog:not([open])")) closed.show();
}"""

_CLOSE = """() => {
  for (const opened of document.querySelectorAll("dialog[open]")) opened.close();
  for (const opened of document.querySelectorAll("details[open]")) opened.open = false;
  document.activeElement?.blur();
}"""


def violations(page, sizes=SIZES, colours=False):
    """{what axe-core says: widths [px]} of a page with all that it can unfold; with `colours` of these alone."""
    page.evaluate(_AXE.read_text("utf-8"))
    page.evaluate(_OPEN)
    found: dict[str, list[int]] = {}
    for width, height in sizes:
        page.set_viewport_size({"width": width, "height": height})
        for said in page.evaluate(_RUN, colours):
            found.setdefault(said, []).append(width)
    page.evaluate(_CLOSE)
    return found


def themed(context, theme):
    """All pages of this context are dark, or light."""
    context.add_init_script(f"localStorage.setItem('eva-theme', '{theme}')")
