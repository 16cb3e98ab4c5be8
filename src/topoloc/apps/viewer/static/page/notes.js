// Notes at places of the map, which all who look at it share: a list, and a dialog to write and read one.
import { addNote, notesOf, removeNote } from "topoloc/page/asking";
import { saveText } from "topoloc/page/answers";

const PERIOD_MS = 3000;

export class Notes {
  /** `told.changed(notes)` gets the notes of the map whenever they differ, `told.grown()` that its file did, `told.failed(error)` why a note is not kept. */
  constructor(section, dialog, told) {
    Object.assign(this, { section, dialog, told, map: "", text: "[]", position: null, note: null });
    this.field = dialog.querySelector("textarea");
    dialog.querySelector("form").addEventListener("submit", (event) => this.decide(event));
    section.querySelector("button.plain").addEventListener("click", () => saveText(`${this.map}.notes.json`, this.text));
  }

  /** Show the notes of this map from now on. */
  follow(map) {
    [this.map, this.revision] = [map, ""];
    clearTimeout(this.timer);
    this.show([]);
    if (map) this.poll();
  }

  async poll() {
    clearTimeout(this.timer);
    const { map } = this;
    const found = document.hidden ? null : await notesOf(map).catch(() => null); // the next one may come
    if (map !== this.map) return;
    if (found) {
      this.show(found.notes);
      if (this.revision && this.revision !== found.revision) this.told.grown();
      this.revision = found.revision;
    }
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.poll(), PERIOD_MS);
  }

  show(notes) {
    const text = JSON.stringify(notes, null, 1);
    if (text === this.text) return;
    this.text = text;
    this.section.hidden = !notes.length;
    this.section.querySelector("ul").replaceChildren(...notes.map((note) => this.row(note)));
    this.told.changed(notes);
  }

  row(note) {
    const [item, button] = ["li", "button"].map((kind) => document.createElement(kind));
    Object.assign(button, { type: "button", textContent: note.text });
    button.addEventListener("click", () => this.read(note));
    item.append(button);
    return item;
  }

  /** Ask for the text of a note at this position. */
  write(position) {
    Object.assign(this, { position, note: null });
    this.ask("New note", "", "Save");
  }

  /** Show a note, which can be deleted. */
  read(note) {
    this.note = note;
    const [day, time] = note.created.split("T");
    this.ask(`Note of ${day}, ${time.slice(0, 5)} UTC`, note.text, "Delete");
  }

  ask(title, text, action) {
    this.dialog.querySelector("h2").textContent = title;
    Object.assign(this.field, { value: text, readOnly: this.note !== null });
    this.dialog.querySelector("button.main").textContent = action;
    this.dialog.showModal();
  }

  decide(event) {
    event.preventDefault();
    const text = this.field.value.trim();
    const isMeant = event.submitter?.value === "do";
    if (isMeant && !text) return this.field.focus();
    this.dialog.close();
    if (isMeant) this.change(this.note ? removeNote(this.map, this.note.id) : addNote(this.map, text, this.position));
  }

  async change(asked) {
    await asked.catch((error) => this.told.failed(error));
    this.poll();
  }
}
