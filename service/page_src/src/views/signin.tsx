// Asks for an API key. It is kept in memory until the page is closed, and never in an address.

import { useState } from "preact/hooks";

export function SignIn({ problem, enter }: { problem: string; enter: (key: string) => void }) {
  const [key, setKey] = useState("");
  return (
    <form
      class="card signin"
      onSubmit={(event) => {
        event.preventDefault();
        enter(key.trim());
      }}
    >
      <h1>Sign in</h1>
      <p class="quiet">With an API key, made by <code>lvba admin key create</code>. It stays in this page only.</p>
      <label for="key">API key</label>
      <input
        id="key" type="password" autocomplete="current-password" required value={key} aria-describedby="key-problem"
        onInput={(event) => { setKey(event.currentTarget.value); }}
      />
      <p id="key-problem" role="status" class="field-problem">{key === "" ? "" : problem}</p>
      <button type="submit" class="primary">Sign in</button>
    </form>
  );
}
