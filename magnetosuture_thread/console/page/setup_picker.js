// Setup picker: a button, a list and a question, all of them elements of the page. The popup of a native list swallows
// key events: a key that is released while it is open, and Space, would never reach the page.

const find = (id) => document.getElementById(id);

export class SetupPicker {
  // select(name) is called when a setup was chosen and confirmed; running() returns what it would end, or nothing.
  constructor({ select, running }) {
    this.button = find("setup");
    this.list = find("setups");
    this.question = find("question");
    this.names = [];
    this.current = "";
    this.chosen = "";
    this.button.addEventListener("click", () => (this.list.hidden ? this.open() : this.close()));
    this.button.addEventListener("keydown", (event) => {
      if (event.code === "Enter" || event.code === "NumpadEnter") {
        event.preventDefault();
        this.open();
      }
    });
    this.list.addEventListener("keydown", (event) => this.#key(event));
    this.list.addEventListener("click", ({ target }) => this.#choose(target.closest("[role=option]")?.dataset.name));
    this.list.addEventListener("focusout", ({ relatedTarget }) => {
      if (relatedTarget !== this.button && !this.list.contains(relatedTarget)) this.close();
    });
    find("confirm").addEventListener("click", () => {
      this.#answer();
      select(this.chosen);
    });
    find("cancel").addEventListener("click", () => this.#answer());
    this.question.addEventListener("keydown", ({ code }) => code === "Escape" && this.#answer());
    this.select = select;
    this.running = running;
  }

  // Show the setups that there are, the one in use, and whether another may be chosen.
  show(names, current, allowed, display) {
    if (names.join("\n") !== this.names.join("\n")) {
      this.names = names;
      this.list.replaceChildren(...names.map((name) => {
        const option = document.createElement("li");
        Object.assign(option, { textContent: display(name), tabIndex: -1 });
        option.setAttribute("role", "option");
        option.dataset.name = name;
        return option;
      }));
    }
    this.current = current;
    const text = current ? display(current) : "none";
    if (this.button.textContent !== text) this.button.textContent = text;
    this.button.disabled = !allowed;
    for (const option of this.list.children) option.setAttribute("aria-selected", String(option.dataset.name === current));
    if (!allowed) {
      this.close();
      this.#answer();
    }
  }

  open() {
    this.list.hidden = false;
    this.button.setAttribute("aria-expanded", "true");
    (this.list.querySelector('[aria-selected="true"]') ?? this.list.firstElementChild)?.focus();
  }

  close() {
    if (this.list.hidden) return;
    const within = this.list.contains(document.activeElement);
    this.list.hidden = true;
    this.button.setAttribute("aria-expanded", "false");
    if (within) this.button.focus();
  }

  // Ask before a setup, chosen again or another one, ends what is running.
  ask(name) {
    this.chosen = name;
    const ends = this.running();
    if (!ends) return this.select(name);
    find("question-text").textContent = `${name === this.current ? "Start again" : "Change the setup"}? This ends ${ends}.`;
    this.question.hidden = false;
    find("cancel").focus();
  }

  #key(event) {
    const options = [...this.list.children];
    const at = options.indexOf(document.activeElement);
    const to = { ArrowDown: at + 1, ArrowUp: at - 1, Home: 0, End: options.length - 1 }[event.code];
    if (to !== undefined) options[Math.min(Math.max(to, 0), options.length - 1)]?.focus();
    else if (event.code === "Enter" || event.code === "NumpadEnter") this.#choose(document.activeElement?.dataset.name);
    else if (event.code === "Escape") this.close();
    else return;
    event.preventDefault();
  }

  #choose(name) {
    if (!name) return;
    this.close();
    if (name !== this.current) this.ask(name);
  }

  #answer() {
    if (this.question.hidden) return;
    const within = this.question.contains(document.activeElement);
    this.question.hidden = true;
    if (within) (this.button.disabled ? find("dish") : this.button).focus();
  }
}
