// Asks for an API key. The browser keeps it until the tab is closed, or longer if asked; it is never in an address.

import { useState } from "preact/hooks";

export function SignIn({ problem, enter }: { problem: string; enter: (key: string, stay: boolean) => void }) {
  const [key, setKey] = useState("");
  const [stay, setStay] = useState(false);
  return (
    <form
      class="card signin"
      onSubmit={(event) => {
        event.preventDefault();
        enter(key.trim(), stay);
      }}
    >
      <h1>Sign in</h1>
      <p class="quiet">With an API key, made by <code>lvba admin key create</code>. It is kept in this tab until you sign out or close it.</p>
      <label for="key">API key</label>
      <input
        id="key" type="password" autocomplete="current-password" required value={key} aria-describedby="key-problem"
        onInput={(event) => { setKey(event.currentTarget.value); }}
      />
      <label class="check"><input type="checkbox" checked={stay} onChange={(event) => { setStay(event.currentTarget.checked); }} /> Keep me signed in on this computer</label>
      <p id="key-problem" role="status" class="field-problem">{key === "" ? "" : problem}</p>
      <button type="submit" class="primary">Sign in</button>
    </form>
  );
}
