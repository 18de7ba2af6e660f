// Panels of which one is shown at a time; the one that was shown last is shown again after a reload.

/** Follow the buttons with data-open-panel; returns {open(name), shown} and tells "eva:panel" on the document. */
export function panels(element) {
  const key = `eva-panel-${element.dataset.panels}`;
  const buttons = [...element.querySelectorAll("[data-open-panel]")];
  const names = buttons.map((button) => button.dataset.openPanel);
  let shown = names[0];
  const open = (name) => {
    shown = name;
    sessionStorage.setItem(key, name);
    for (const button of buttons) {
      const here = button.dataset.openPanel === name;
      button.setAttribute("aria-selected", String(here));
      document.getElementById(button.getAttribute("aria-controls")).hidden = !here;
    }
    document.dispatchEvent(new CustomEvent("eva:panel", { detail: name }));
  };
  for (const button of buttons) button.addEventListener("click", () => open(button.dataset.openPanel));
  const before = sessionStorage.getItem(key);
  open(names.includes(before) ? before : shown);
  return {
    open,
    get shown() {
      return shown;
    },
  };
}
