// What was typed and not yet sent outlives a reload and a replaced fragment, and is forgotten once it was saved.

const KEY = (name) => `eva-draft:${name}`;

function fields(owner) {
  return owner.matches("form") ? [...owner.elements].filter((field) => field.name) : [owner];
}

function valuesOf(owner) {
  const values = {};
  for (const field of fields(owner)) {
    const name = field.name || field.id;
    if (field.type === "checkbox") values[`${name}=${field.value}`] = field.checked;
    else if (field.type === "radio") {
      if (field.checked) values[name] = field.value;
    } else values[name] = field.value;
  }
  return values;
}

function fill(owner, values) {
  for (const field of fields(owner)) {
    const name = field.name || field.id;
    if (field.type === "checkbox") field.checked = values[`${name}=${field.value}`] ?? field.checked;
    else if (!(name in values)) continue;
    else if (field.type === "radio") {
      const offered = fields(owner).some((other) => other.name === name && other.value === values[name]);
      if (offered) field.checked = field.value === values[name];
    }
    else if (field.tagName === "SELECT") choose(field, values[name]);
    else field.value = values[name];
  }
}

/** Choose what was chosen, where it is still offered; whoever follows the choice hears of it. */
function choose(select, value) {
  if (select.value === value || ![...select.options].some((option) => option.value === value)) return;
  select.value = value;
  select.dispatchEvent(new Event("change", { bubbles: true }));
}

function restore() {
  for (const owner of document.querySelectorAll("[data-draft]")) {
    const saved = sessionStorage.getItem(KEY(owner.dataset.draft));
    if (saved) fill(owner, JSON.parse(saved));
  }
}

/** Keep drafts of everything with data-draft; "eva:saved" on it forgets its draft. */
export function drafts() {
  document.addEventListener("input", (event) => {
    const owner = event.target.closest("[data-draft]");
    if (owner) sessionStorage.setItem(KEY(owner.dataset.draft), JSON.stringify(valuesOf(owner)));
  });
  document.addEventListener("eva:saved", (event) => {
    const owner = event.target.closest("[data-draft]");
    if (owner) sessionStorage.removeItem(KEY(owner.dataset.draft));
  });
  // At once: what is typed into a new fragment before it was filled would take the place of its draft.
  document.body.addEventListener("htmx:afterSwap", restore);
  document.body.addEventListener("htmx:afterSettle", restore);
  restore();
}
