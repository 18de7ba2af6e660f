// Keeps what was typed but not yet sent across a reload or a replaced fragment, and forgets it once it was saved.

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

/** Restore the choice `value` if the list still offers it, and send "change" for scripts that follow the choice. */
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

/** Keep drafts of all fields and forms with data-draft; the event "eva:saved" on one of them deletes its draft. */
export function drafts() {
  document.addEventListener("input", (event) => {
    const owner = event.target.closest("[data-draft]");
    if (owner) sessionStorage.setItem(KEY(owner.dataset.draft), JSON.stringify(valuesOf(owner)));
  });
  document.addEventListener("eva:saved", (event) => {
    const owner = event.target.closest("[data-draft]");
    if (owner) sessionStorage.removeItem(KEY(owner.dataset.draft));
  });
  // Restore right after the swap: text typed into the new fragment before that would overwrite its draft.
  document.body.addEventListener("htmx:afterSwap", restore);
  document.body.addEventListener("htmx:afterSettle", restore);
  restore();
}
