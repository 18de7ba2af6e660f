// Panels of which one is shown at a time; a reload shows the same one again.

/** Follow the buttons with data-open-panel; return {open(name), shown} and send "eva:panel" on the document at every change. */
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
